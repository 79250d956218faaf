"""The commands of the command line, each from its settings to a report; see `fits.commands.run`."""
