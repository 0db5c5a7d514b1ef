"""What is left of a policy when robot, sensors and ground are not those of its training."""
