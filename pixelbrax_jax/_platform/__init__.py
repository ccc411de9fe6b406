"""Code that depends on the device; the choice is made when a program is lowered."""
