"""Pictures of robots and terrain."""
