"""Import of robot models from URDF and any MJCF. A model becomes a tree of links and hinges, then MJCF for the engines."""
