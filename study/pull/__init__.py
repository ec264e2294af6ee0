"""A page in which the mouse pulls the hand and a reduced model of the tissue follows."""
