"""How well parameters and predictions are known, and the noise behind them."""
