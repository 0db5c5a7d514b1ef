"""The stress test: policies on robots, sensors and ground that differ from those of the training."""
