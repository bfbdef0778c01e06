"""Parts of the node `operator_page`: the web server, the displayed state, and the web page
itself."""
