"""Experiment files: what they can say, with a sentence for each mistake."""
