"""Recordings of single episodes: they are sorted by what went wrong and shown as pages and as statistics of joints."""
