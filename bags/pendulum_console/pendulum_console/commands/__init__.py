"""The command lines: options in, a server until Ctrl-C; nothing imports them."""
