"""The public walking league for Unitree's G1: waypoints, arms that move, and punches; and the same runs for an H1."""
