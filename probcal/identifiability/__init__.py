"""What data and surveys leave open: gauge and weak directions, their names, and remedies that are checked."""
