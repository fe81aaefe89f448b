//! An S3 server for tests, with buckets in folders: `s3 FOLDER PORT KEY SECRET FAIL_EVERY`. The folders in FOLDER are the
//! buckets. Every FAIL_EVERY-th request fails as if the server were overloaded; 0 for none.
#![allow(clippy::unwrap_used)]

use std::env::args;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use s3s::auth::SimpleAuth;
use s3s::service::S3ServiceBuilder;
use s3s_fs::FileSystem;
use tokio::net::TcpListener;

fn main() {
    let args: Vec<String> = args().skip(1).collect();
    let [folder, port, key, secret, fail_every] = &args[..] else {
        panic!("usage: s3 FOLDER PORT KEY SECRET FAIL_EVERY")
    };
    let (port, fail_every): (u16, u64) = (port.parse().unwrap(), fail_every.parse().unwrap());
    let mut builder = S3ServiceBuilder::new(FileSystem::new(folder).unwrap());
    builder.set_auth(SimpleAuth::from_single(key, secret.as_str()));
    let (s3, requests) = (builder.build(), Arc::new(AtomicU64::new(0)));
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
    runtime.unwrap().block_on(async {
        let listener = TcpListener::bind(("127.0.0.1", port)).await.unwrap();
        loop {
            let (socket, _) = listener.accept().await.unwrap();
            let (s3, requests) = (s3.clone(), requests.clone());
            let serve = service_fn(move |request: Request<hyper::body::Incoming>| {
                let count = requests.fetch_add(1, Ordering::Relaxed) + 1;
                let (s3, fails) = (s3.clone(), fail_every > 0 && count.is_multiple_of(fail_every));
                async move {
                    if fails { Ok(overloaded()) } else { s3.call(request.map(s3s::Body::from)).await }
                }
            });
            tokio::spawn(async move {
                let _ = http1::Builder::new().serve_connection(TokioIo::new(socket), serve).await;
            });
        }
    });
}

fn overloaded() -> Response<s3s::Body> {
    let mut response = Response::new(s3s::Body::empty());
    *response.status_mut() = StatusCode::SERVICE_UNAVAILABLE;
    response
}
