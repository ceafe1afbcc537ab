"""The command `tensormass` and its subcommands. Built on the SDK and the gateway, which do not know it."""
