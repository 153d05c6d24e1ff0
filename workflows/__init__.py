"""The command line, the scenes that ship, and how the floors below are put together."""

#: What is said of a file that cannot be written for want of its folder.
NO_FOLDER = "the folder does not exist: create it or choose another"
