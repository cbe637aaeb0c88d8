//! Responses of a server in a fleet end once its fence has passed, the time until which it may act. A frozen server
//! that resumes has samples and responses waiting to be sent; another server may have the session by then.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use bytes::Bytes;
use http::HeaderMap;
use http_body::Frame;
use tonic::Status;
use tonic::body::Body;

use palpate_realtime::fence::Fence;
use palpate_realtime::fenced;

/// The body of a response, which ends with an error once the fence has passed.
pub(in crate::server) struct FencedBody {
    body: Body,
    fence: Arc<Fence>,
    is_over: bool,
}

impl FencedBody {
    pub(in crate::server) fn wrap(body: Body, fence: Arc<Fence>) -> Body {
        Body::new(FencedBody { body, fence, is_over: false })
    }
}

impl http_body::Body for FencedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        if self.is_over {
            return Poll::Ready(None);
        }
        let frame = Pin::new(&mut self.body).poll_frame(context);
        // Checked after the frame was created, so that no freeze can lie between.
        if !self.fence.may_act() {
            self.is_over = true;
            let mut trailers = HeaderMap::new();
            let _ = Status::from(fenced()).add_header(&mut trailers);
            return Poll::Ready(Some(Ok(Frame::trailers(trailers))));
        }
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.is_over || self.body.is_end_stream()
    }
}
