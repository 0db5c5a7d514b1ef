"""Evaluations of policies: tracking errors, success on terrain, other engines."""
