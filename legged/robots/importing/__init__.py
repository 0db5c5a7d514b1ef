"""Models of others (URDF, MJCF of any kind) -> a tree of links that hang on hinges, and MJCF as the engines rely on it."""
