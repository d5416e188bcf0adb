"""What the user meets: the command line and its parts; it stands on top of everything else and nothing imports it."""
