-- Version 15: nobody is in quarantine any more. New databases do not have the table.

DROP TABLE IF EXISTS outcasts;
