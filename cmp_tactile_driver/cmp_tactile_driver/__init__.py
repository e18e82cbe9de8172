"""Frame sources and the nodes that publish their frames."""
