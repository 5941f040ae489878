"""Goals that hold for most pieces made with tolerances, and the second-order moments behind them."""
