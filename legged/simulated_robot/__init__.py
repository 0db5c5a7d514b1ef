"""A simulated robot: C MuJoCo in real time, reached by UDP like a real robot."""
