"""The command lines: options in, text and files out; nothing imports them."""
