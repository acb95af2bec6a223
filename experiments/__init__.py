"""One command for each claim and figure of the thesis."""
