"""Set-up of a process before any task: imports, display, paths, cores, ranks."""
