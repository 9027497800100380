"""The directions that data and surveys leave open: gauge or weak, their names, checked remedies."""
