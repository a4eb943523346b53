"""Any recording as named columns, and what they are: by a mapping file, or guessed and tested."""
