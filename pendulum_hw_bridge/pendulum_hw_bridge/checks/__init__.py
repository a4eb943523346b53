"""The checklist before arming."""
