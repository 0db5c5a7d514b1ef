"""What a process is before any task: imports, display, paths, cores, ranks."""
