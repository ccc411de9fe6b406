"""Physics engines and tasks, one folder for each suite. Importing it loads nothing."""
