"""Imported before anything heavy: imports are a good part of a start."""

import time

STARTED_S = time.perf_counter()
"""When this package was first imported, on the clock of `time.perf_counter` [s]."""
