"""Reports on runs: one page about a training, a table of many, several side by side; as HTML and as Markdown."""
