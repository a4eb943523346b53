"""Live view and stop of the plants of a ROS domain: in a browser, in Foxglove and Lichtblick."""

__version__ = "0.1.0"
