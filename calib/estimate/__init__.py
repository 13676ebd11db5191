"""S, Q and everything else that moves the data, estimated together."""
