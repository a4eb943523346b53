"""The console: a web page that shows the plants of a ROS domain live, and lets a person tune, arm and stop them."""
