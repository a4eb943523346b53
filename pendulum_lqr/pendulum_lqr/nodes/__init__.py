"""The programs on the graph but the disturbance, which has a room of its own, and what they do without ROS."""
