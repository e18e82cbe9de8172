"""The subcommands of `cmp_tactile calibrate`: optics, gel and material of a sensor."""
