"""Pictures of plants: for windows, markers, environments and pages."""
