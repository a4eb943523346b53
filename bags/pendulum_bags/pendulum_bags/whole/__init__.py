"""All four layers in one run: a given plant and the one identified from it, against one machine."""
