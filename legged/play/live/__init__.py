"""Live view of a policy in a browser: the simulation (`session`), the checkpoint (`source`) and the web page (`page`)."""
