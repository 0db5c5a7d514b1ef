"""Sensors: measurements of robots and their surroundings. To add one, write a subclass of `Sensor` (sensor.py)."""

from legged.mdp.sensors.bodies import BodyStates
from legged.mdp.sensors.contact_forces import ContactForces
from legged.mdp.sensors.height_scan import HeightScan
from legged.mdp.sensors.sensor import Sensor

__all__ = ["BodyStates", "ContactForces", "HeightScan", "Sensor"]
