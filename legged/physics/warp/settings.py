"""Settings of Warp: every package here with kernels imports them before anything else."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING
wp.config.enable_backward = False  # nothing here is differentiated, and adjoints double the time to compile
wp.init()
