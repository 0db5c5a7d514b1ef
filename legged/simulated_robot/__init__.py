"""A robot that is not there: C MuJoCo in real time behind UDP, as the robot's program sees one."""
