"""Robot and ground as one MuJoCo model."""
