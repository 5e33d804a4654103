"""Terms that are learned where no name explains what is missing."""
