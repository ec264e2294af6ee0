"""`softgrasp effects`: what every effect costs and changes."""
