"""Names of elements that the scene adds to a robot's model."""

FLOOR = "floor"
"""Name of the geom that is the ground (a plane or a height map). No geom of a robot may have this name."""
RESERVED = {"geom": r"floor|terrain_\d+", "sensor": "contact_.*"}
"""Kind of element -> regular expression of the names that the scene needs. A robot's elements must not have these names."""
