"""Run folders, plots and tables for people: mm and degrees, with the unit written."""
