"""The bridge: modules under the rules of a plant, one cycle at a time, and the parameters that make them."""
