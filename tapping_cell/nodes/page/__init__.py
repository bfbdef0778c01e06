"""What the node `operator_page` is made of: the web server, what it shows, and the page itself."""
