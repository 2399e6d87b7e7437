"""Create the buckets of a new object store and the account of trainers on a new tracking server.

Does nothing where they exist, so it can run at every start. Buckets are arguments; everything else comes
from the environment: AWS_*, MLFLOW_TRACKING_URI, MLFLOW_AUTH_ADMIN_PASSWORD (of the account `admin`), and
MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD for the account of trainers.
"""

import base64
import json
import os
import sys
import urllib.error
import urllib.request

import boto3
from botocore.exceptions import ClientError


def create_bucket(name: str) -> str:
    """Create a bucket unless it is there; return what was done."""
    store = boto3.client("s3", endpoint_url=os.environ.get("AWS_ENDPOINT_URL") or None)
    try:
        store.head_bucket(Bucket=name)
    except ClientError as error:
        if error.response["ResponseMetadata"]["HTTPStatusCode"] != 404:
            raise
        region = store.meta.region_name
        place = {} if region == "us-east-1" else {"CreateBucketConfiguration": {"LocationConstraint": region}}
        store.create_bucket(Bucket=name, **place)
        return f"bucket {name}: created"
    return f"bucket {name}: exists"


def create_account(user: str, password: str) -> str:
    """Create an account of the tracking server unless it is there; return what was done."""
    admin = f"admin:{os.environ['MLFLOW_AUTH_ADMIN_PASSWORD']}"
    request = urllib.request.Request(
        os.environ["MLFLOW_TRACKING_URI"].rstrip("/") + "/api/2.0/mlflow/users/create",
        data=json.dumps({"username": user, "password": password}).encode(),
        headers={
            "Authorization": "Basic " + base64.b64encode(admin.encode()).decode(),
            "Content-Type": "application/json",
        },
    )
    try:
        urllib.request.urlopen(request, timeout=30).close()
    except urllib.error.HTTPError as error:
        answer = error.read().decode(errors="replace")
        if "RESOURCE_ALREADY_EXISTS" not in answer:
            raise SystemExit(f"error: account {user} was not created: {error} {answer}") from None
        return f"account {user}: exists"
    return f"account {user}: created"


def main() -> None:
    """Create everything, saying so line by line."""
    for bucket in sys.argv[1:]:
        print(create_bucket(bucket))
    print(create_account(os.environ["MLFLOW_TRACKING_USERNAME"], os.environ["MLFLOW_TRACKING_PASSWORD"]))


if __name__ == "__main__":
    main()
