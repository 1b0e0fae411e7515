"""The command line's subcommands, by what they do; heavy imports belong into the functions that need them."""
