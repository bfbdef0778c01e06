"""Run folders, plots and tables for users, in mm and degrees, with units stated."""
