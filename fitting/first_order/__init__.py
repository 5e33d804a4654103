"""The linearised fit that screening, learned terms, evidence and clocks share."""
