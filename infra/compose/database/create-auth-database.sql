-- The tracking server keeps accounts apart from runs.
CREATE DATABASE mlflow_auth;
