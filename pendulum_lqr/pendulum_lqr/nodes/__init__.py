"""The programs on the graph, and what they do without ROS."""
