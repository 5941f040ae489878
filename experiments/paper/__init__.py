"""The study of de Falco, Pennestri and Vita (2005), done again: its runs, what would have been better, and a page about both.

`udkjax report` runs it. It is installed as `udkjax.paper`, so its modules name each other by relative imports.
"""
