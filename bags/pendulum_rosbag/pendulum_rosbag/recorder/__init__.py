"""Recording: which topics, gap counting, the bounded queue, the threads that write, and the node."""
