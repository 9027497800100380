"""Analysis: what data can tell before a fit, and what a fit is worth after it."""
