//! An object store in memory with delayed or missing answers, for tests of stores on a bucket.

use std::fmt;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use futures::stream::BoxStream;
use futures::{FutureExt as _, StreamExt as _};
use object_store::memory::InMemory;
use object_store::multipart::{MultipartStore, PartId};
use object_store::path::Path;
use object_store::{
    CopyOptions, GetOptions, GetResult, ListResult, MultipartId, MultipartUpload, ObjectMeta, ObjectStore,
    PutMultipartOptions, PutOptions, PutPayload, PutResult, Result,
};
use tokio::sync::watch;

use crate::blob::Backend;
use crate::blob::objects::{Objects, Remote};

/// A bucket of this process. Clones share it.
#[derive(Debug, Clone)]
pub struct SlowBucket(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    objects: Arc<InMemory>,
    requests: AtomicU64,
    line: watch::Sender<Line>,
}

/// State of the connection to the bucket.
#[derive(Debug, Clone, Copy)]
struct Line {
    delay: Duration,
    is_silent: bool,
}

impl Default for SlowBucket {
    fn default() -> Self {
        Self::over(Arc::new(InMemory::new()))
    }
}

impl fmt::Display for SlowBucket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a slow bucket")
    }
}

impl SlowBucket {
    fn over(objects: Arc<InMemory>) -> Self {
        let line = watch::Sender::new(Line { delay: Duration::ZERO, is_silent: false });
        Self(Arc::new(Inner { objects, requests: AtomicU64::new(0), line }))
    }

    /// Returns the same bucket behind a separate connection.
    pub fn of_another(&self) -> Self {
        Self::over(Arc::clone(&self.0.objects))
    }

    /// Delays every request from now on.
    pub fn delay(&self, delay: Duration) {
        self.0.line.send_modify(|line| line.delay = delay);
    }

    /// Stops or resumes answers. Pending requests are answered after it ends.
    pub fn silence(&self, is_silent: bool) {
        self.0.line.send_modify(|line| line.is_silent = is_silent);
    }

    /// Returns the number of requests so far.
    pub fn requests(&self) -> u64 {
        self.0.requests.load(Ordering::SeqCst)
    }

    /// Opens `prefix` in the bucket for the store in `dir`. Only for the holder of the store's lock.
    ///
    /// # Panics
    /// Panics if the folder is not writable.
    pub fn place(&self, prefix: &str, dir: &FilePath) -> Arc<dyn Backend> {
        let remote = Remote::over(&format!("s3://slow/{prefix}"), Arc::new(self.clone())).expect("a place");
        Arc::new(Objects::open(Arc::new(remote), dir).expect("a folder of ours"))
    }

    async fn pass(&self) {
        self.0.requests.fetch_add(1, Ordering::SeqCst);
        let mut line = self.0.line.subscribe();
        let delay = line.borrow().delay;
        tokio::time::sleep(delay).await;
        // The sender lives as long as this bucket.
        let _ = line.wait_for(|line| !line.is_silent).await;
    }
}

#[async_trait]
impl ObjectStore for SlowBucket {
    async fn put_opts(&self, path: &Path, payload: PutPayload, options: PutOptions) -> Result<PutResult> {
        self.pass().await;
        self.0.objects.put_opts(path, payload, options).await
    }

    async fn put_multipart_opts(&self, path: &Path, options: PutMultipartOptions) -> Result<Box<dyn MultipartUpload>> {
        self.pass().await;
        self.0.objects.put_multipart_opts(path, options).await
    }

    async fn get_opts(&self, path: &Path, options: GetOptions) -> Result<GetResult> {
        self.pass().await;
        self.0.objects.get_opts(path, options).await
    }

    fn delete_stream(&self, paths: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
        let bucket = self.clone();
        let objects = self.clone();
        let paths = paths.then(move |path| {
            let bucket = bucket.clone();
            async move {
                bucket.pass().await;
                path
            }
        });
        objects.0.objects.delete_stream(paths.boxed())
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        let bucket = self.clone();
        let all = self.0.objects.list(prefix);
        async move {
            bucket.pass().await;
            all
        }
        .flatten_stream()
        .boxed()
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.pass().await;
        self.0.objects.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.pass().await;
        self.0.objects.copy_opts(from, to, options).await
    }
}

#[async_trait]
impl MultipartStore for SlowBucket {
    async fn create_multipart(&self, path: &Path) -> Result<MultipartId> {
        self.pass().await;
        self.0.objects.create_multipart(path).await
    }

    async fn put_part(&self, path: &Path, id: &MultipartId, number: usize, part: PutPayload) -> Result<PartId> {
        self.pass().await;
        self.0.objects.put_part(path, id, number, part).await
    }

    async fn complete_multipart(&self, path: &Path, id: &MultipartId, parts: Vec<PartId>) -> Result<PutResult> {
        self.pass().await;
        self.0.objects.complete_multipart(path, id, parts).await
    }

    async fn abort_multipart(&self, path: &Path, id: &MultipartId) -> Result<()> {
        self.pass().await;
        self.0.objects.abort_multipart(path, id).await
    }
}
