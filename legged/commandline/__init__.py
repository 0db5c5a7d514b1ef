"""Commands as processes: flags, output, stopping, exit codes."""
