"""The ROS side of the vocabulary: QoS, conversions, parameters, the node runner and the interface of a plant."""
