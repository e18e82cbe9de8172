"""The subcommands of `cmp_tactile`: each module has add_parser(subcommands, common) and run."""
