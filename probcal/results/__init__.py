"""Results: what every method hands over, and the labelled DataTree that is made of it."""
