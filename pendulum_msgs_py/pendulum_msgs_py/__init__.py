"""The vocabulary that every pendulum package shares: values, names, units, angles, errors and plant rules.

Nothing outside the ``ros`` subpackage imports ROS, so that the same words serve a node, a notebook and a test.
"""

__version__ = "0.1.0"
