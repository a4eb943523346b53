"""Live in the viewers that people have: topics, parameters and services over the Foxglove WebSocket protocol."""
