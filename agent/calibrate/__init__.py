"""`fieldcal calibrate`: from files to windows, to S and Q, to a table or JSON."""
