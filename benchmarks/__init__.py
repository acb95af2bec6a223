"""Comparisons with other libraries, one command each; each peer runs beside ours in the same program."""
