"""The console: a web page that shows the plants of a ROS domain live, to tune, arm and stop them."""
