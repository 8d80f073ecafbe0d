import time, pickle, itertools
import numpy as np
from pathlib import Path
from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.scene.image_files.image_file import decode_image
D=Path('/work/shared/data/home_streetview')
pics={p.stem:decode_image(p) for p in sorted(D.glob('*.jpg'))}
t=time.process_time()
feats={}
for n,im in pics.items():
    H,W=im.shape[:2]
    m=np.ones((H,W),bool); m[int(H*(180-25)/180):]=False
    feats[n]=extract_sift(im,m,max_keypoints=12000)
    print(n,im.shape,len(feats[n]),time.process_time()-t)
pickle.dump((pics,feats),open('home.pkl','wb'))
for a,b in itertools.combinations(feats,2):
    t=time.process_time()
    m=match_features(feats[a],feats[b])
    v=verify_pair(feats[a],feats[b],m,rng=np.random.default_rng(1))
    print(a,b,len(m),v.geometry,len(v),v.reason,'std',v.direction_std_deg,'par',v.parallax_deg,time.process_time()-t, flush=True)
