"""What is done with a whole site or many recordings at once: `fieldcal fleet`."""
