"""The response of fits to noise."""
