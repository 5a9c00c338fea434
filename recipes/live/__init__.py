"""A task that runs in real time while people steer it: its state, what is drawn of it, and the page in the browser."""
