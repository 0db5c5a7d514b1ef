"""Import of robot models from URDF and any MJCF: a tree of links and hinges, and MJCF in the form that the engines need."""
