"""Nodes of the bridge, of the e-stop input and of the thesis's two experiments."""
