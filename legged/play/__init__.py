"""A policy on show: its ground, its outing, films, the window, and the page in a browser (live/)."""
