"""Analysis of problems and fits: is the answer good?"""
