"""Names of elements that the scene adds to a robot's model."""

FLOOR = "floor"
"""Name of the ground's geom, a plane or a height map. No geom of a robot may have this name."""
RESERVED = {"geom": r"floor|terrain_\d+", "sensor": "contact_.*"}
"""Kind of element -> pattern of the names that the scene needs; no element of a robot may have one of them."""
