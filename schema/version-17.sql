-- Version 17: the data of environments can have a task after the 66 doubles. SQLite cannot alter a
-- check, so its text is replaced; every stored row satisfies the new one.

PRAGMA writable_schema=ON;
UPDATE sqlite_schema SET sql=replace(sql,'CHECK(length(data) = 528)','CHECK(length(data) >= 528)')
  WHERE name='environments' AND type='table';
PRAGMA writable_schema=RESET;
