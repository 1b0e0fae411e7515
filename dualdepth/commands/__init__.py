"""The command line's subcommands, one file each; heavy imports belong into the functions that need them."""
