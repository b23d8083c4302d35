"""The command line: options, tables and exit statuses. Rich is imported only here."""
