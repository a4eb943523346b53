"""Names, values, units, angles, errors and plant rules shared by all packages.

Only the ``ros`` subpackage imports ROS: nodes, notebooks and tests use the same definitions.
"""

__version__ = "0.1.0"
