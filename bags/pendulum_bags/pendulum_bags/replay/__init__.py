"""Plants driven by recorded torque, controllers fed with recorded states."""
