"""The bridge's node, the e-stop's, and that of the thesis's two experiments."""
