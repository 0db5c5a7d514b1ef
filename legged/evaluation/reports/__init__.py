"""Reports on runs: a page on one training, a table of many, a comparison of several; as HTML and as Markdown."""
