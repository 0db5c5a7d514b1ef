"""Demonstrations of a policy: the ground, the commands, films, MuJoCo's window, and a page in a browser (live/)."""
