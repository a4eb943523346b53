"""The whole answer in one run: a given plant and the one identified from it, beside one machine, in all four layers."""
