"""The collider for height maps."""
