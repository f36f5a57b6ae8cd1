"""Where frames go, pure and told the time: routes, doubles, queues and the books."""
