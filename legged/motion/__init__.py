"""Reference motions of robots: clips, their files, the motion of bodies, and checks."""
