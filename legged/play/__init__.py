"""Demonstration of a policy: its ground, its walk, films, the window, and the page in a browser (live/)."""
