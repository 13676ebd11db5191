"""What is done beside the agent on a gateway: set it up, check it, install it, copy its data."""
