"""What the command line gives, recorded before and after a change."""
