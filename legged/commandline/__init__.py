"""Execution of commands as processes: options, output, signals, exit codes."""
