"""A simulated experiment: its settings, and what they name brought together."""

from jaxsky.experiment.settings import DEFAULT, EXAMPLE, Experiment, load_experiment
from jaxsky.experiment.setup import Setup, build

__all__ = ["DEFAULT", "EXAMPLE", "Experiment", "Setup", "build", "load_experiment"]
