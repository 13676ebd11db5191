"""The fleet page: results of many gateways in one database, and a web page of them."""
