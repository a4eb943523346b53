"""The contract of a plant: names, values, messages as bytes, commands, and the rules of the supervisor."""
