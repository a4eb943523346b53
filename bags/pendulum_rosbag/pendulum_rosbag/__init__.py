"""Recordings: rosbag2 folders that survive anything, read into arrays, mended, exported and played back."""

__version__ = "0.1.0"
