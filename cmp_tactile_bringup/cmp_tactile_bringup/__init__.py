"""Component container, standalone runner and the cmp_tactile command."""
