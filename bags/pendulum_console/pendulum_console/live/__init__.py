"""Live data for viewers: topics, parameters and services over the Foxglove WebSocket protocol."""
