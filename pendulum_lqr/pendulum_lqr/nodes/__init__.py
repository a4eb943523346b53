"""The programs on the graph except the disturbance, and their logic without ROS."""
