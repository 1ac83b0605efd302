-- Version 15: nobody is in quarantine any more.

DROP TABLE outcasts;
