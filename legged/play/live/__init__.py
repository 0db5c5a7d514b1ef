"""A policy on show in a browser: what is simulated (`session`), which policy acts (`source`), and the page that shows it."""
