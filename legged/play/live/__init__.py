"""Live view of a policy in a browser: the simulation (`session`), its `drawing` and `plots`, and the web page (`page`)."""
